"""What is measured in a finished dive: between marked points, and of the ground as a whole."""
