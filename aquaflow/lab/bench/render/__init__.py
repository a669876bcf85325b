"""``lab bench render``: how fast each renderer draws and differentiates the same scenes."""
