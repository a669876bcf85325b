"""How well a dive was mapped: trajectory, picture and water errors against ground truth."""
