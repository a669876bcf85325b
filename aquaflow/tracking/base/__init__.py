"""An earlier dive's keyframes as a base: the new dive is placed among them, and changes nothing."""
