"""The command `thincam`: experiment files, run folders, pages, and a room for each kind of run."""
