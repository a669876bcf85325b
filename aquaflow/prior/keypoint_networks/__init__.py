"""Keypoint networks of others, XFeat and ALIKED with LightGlue: matches that dense flow starts at.

The networks' code is kornia's; their weights lie in packages that the user installs. Nothing of
either is part of AquaFlow, and no code of the weights' packages is run.
"""
