"""Quality of the truck's network link, as reported by the kernel."""
