"""From measured logs to the name of a missing effect, and the blind benchmark that counts how often the name is
right."""
