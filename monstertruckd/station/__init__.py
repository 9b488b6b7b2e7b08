"""The ground station: a web page for one or more robots, and the server of that page.

The station runs on the operator's machine and is an ordinary client of the robots: no part of it runs on a robot, and
it depends only on the daemon's messages.
"""
