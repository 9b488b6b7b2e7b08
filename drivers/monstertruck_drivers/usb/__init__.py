"""USB as the truck sees it: devices named by hub and port, hubs that vanish and return as one."""
