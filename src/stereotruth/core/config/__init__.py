"""All keys of the configuration, each once: unit, limits, default and meaning.

Declarations alone: what a rule takes of them stands in its parameters, so that no code digest
holds a module of this package, and a new key makes nothing again.
"""
