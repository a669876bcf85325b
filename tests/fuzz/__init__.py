"""A fuzzer for the command line: argv, files and folders that nothing sane would pass.

    python -m tests.fuzz --seconds 600                  # every command
    python -m tests.fuzz --seconds 60 --only "prior verify" --seed 7 --keep out/finds

in the root of the checkout. Hypothesis draws the arguments from what the commands themselves
declare, so a new command or option is fuzzed without a line here; paths lead to small files of
every kind that AquaFlow reads, most of them damaged. Every run is a forked process in an empty
folder, with limits of time, memory and file size. What counts as a find is in ``oracles.py``:
tracebacks, crashes, hangs, exit codes that are not documented, half-written files, changed inputs.

Each find is printed once with the command that shows it; ``--keep`` saves the folder it ran in.
Where the fuzzer is root, the commands run as the user ``nobody``; they reach no network beyond
this machine.
"""
