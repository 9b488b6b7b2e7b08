"""The ground station: a web page of one or more robots, and the server of that page.

It runs on the operator's machine and is a client of the robots like any other: nothing of it is on a robot, and it
knows nothing of the daemon but its messages.
"""
