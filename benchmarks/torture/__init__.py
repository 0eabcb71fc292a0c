"""Breaking runs on purpose, and counting what was lost: `make torture`."""
