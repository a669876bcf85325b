"""Videos of a dive: the file, its clock, words over pictures, a camera's smooth path."""
