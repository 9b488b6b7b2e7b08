"""CEVA BNO085 in its UART-RVC mode."""
