"""Command lines: train, tune, sweep, measure."""
