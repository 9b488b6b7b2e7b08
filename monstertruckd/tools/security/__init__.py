"""Certificates of a robot and its stations: authority, issue, renewal, revocation, and the check of a running robot."""
