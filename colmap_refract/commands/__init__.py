"""The commands, a module each: what the command line declares, and what it does.

Whatever takes time to import is imported inside `run`, so that `--help` answers at once.
"""
