"""What every folder stands on: errors, files, clocks, and what the computer has."""
