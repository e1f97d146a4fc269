"""From measured logs to the name of a missing effect, and the blind benchmark that counts how often the name is right.

`setup` turns logs into a problem for `jaxtune.discovery`, `summary` and `report` present its result, and the modules
`blind_*` and `scores` are the benchmark.
"""
