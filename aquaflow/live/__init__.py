"""The onboard service: the live loop, its health, and how it survives."""
