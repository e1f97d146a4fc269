"""jaxtune tunes simulators to measured robots, safely, and says what they are missing."""
