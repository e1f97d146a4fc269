"""Where measured episodes come from."""
