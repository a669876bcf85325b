"""Training and fine-tuning of two-view priors (paper, Sec. 3.1)."""
