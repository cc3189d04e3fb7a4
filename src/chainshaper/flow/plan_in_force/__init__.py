"""The parts of a run that puts a plan in force, which :func:`.apply_plan` joins.

report       what the run shows of itself
threads      the application's threads: found, scheduled, put into servers
anchor       from when on slots count, and where they are by now
phases       shaping nodes get where cycles begin
followers    slots that follow latencies
loops        loops that are kept in step with outputs
origins      where chains begin now, and servers that follow
supervision  the loop that looks at all of them, once a second
"""
