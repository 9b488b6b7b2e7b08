"""Quality of the truck's network link, as the kernel sees it."""
