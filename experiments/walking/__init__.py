"""Policies that walk: how they are trained and loaded, the targets that they walk in, and how well they do."""
