"""maxon EPOS 24/1 motor controller (first generation) over RS232."""
