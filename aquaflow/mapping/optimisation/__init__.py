"""The map's joint optimisation: objective, losses, schedule (Sec. 3.4)."""
