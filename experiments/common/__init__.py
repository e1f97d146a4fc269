"""What all commands share: command line, sizes, checkpoints, pages and pictures."""
