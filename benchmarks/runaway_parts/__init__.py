"""What ``runaway.py`` and the tests of the whole daemon share."""
