"""What judges and feeds the SLAM: synthetic dives, evaluation, benchmarks, training, batches."""
