"""Tests of monstertruckd.

A package, because one that a dependency installs would otherwise be found first.
"""
