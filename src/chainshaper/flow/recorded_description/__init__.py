"""The description of an application as a recording shows it.

Execution times and deliveries are sequences, cycle by cycle as they were: what came together comes
together again.

* :mod:`.evidence`: what a description is made from.
* :mod:`.nodes`: nodes, and their callbacks with what these read, write and take.
* :mod:`.timers`: periods and phases.
* :mod:`.scheduling`: cores, priorities and threads.
* :mod:`.costs`: deliveries, and what they cost.
* :mod:`.sequences`: all these as durations in a file.
"""
