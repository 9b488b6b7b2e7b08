"""Certificates of a robot and its stations: authority, issue, renewal, revocation, and a test of a running robot."""
