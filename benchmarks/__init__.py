"""Speed, measured in whole processes and against peers in the same run: `make bench`."""
