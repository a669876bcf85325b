"""Output to the vehicle: messages for the pilot and poses for the autopilot."""
