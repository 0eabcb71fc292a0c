"""The command line, `mapg`."""
