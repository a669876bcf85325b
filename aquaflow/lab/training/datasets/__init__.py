"""Readers of the data sets that the paper fine-tunes on (paper, Sec. 3.1): one layout a file.

No data set is part of AquaFlow. Each has its own licence, and is read where its owner unpacked it.
"""
