"""Videos of a finished dive: a flight through its map, and its pictures without their water."""
