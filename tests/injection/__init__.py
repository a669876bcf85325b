"""Every call of ours into a library, and every file operation, made to fail once in a whole dive.

Our modules are rewritten as they are imported, so that each of their calls passes one function
(``rewriting.py``, ``watch.py``). Whole dives then run in forked processes: once to learn which
libraries are called from where, and once for every such place with a fault there (``faults.py``).
``python -m tests.injection --all`` prints the table.
"""
