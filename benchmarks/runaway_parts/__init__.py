"""Shared code of ``runaway.py`` and the tests of the whole daemon."""
