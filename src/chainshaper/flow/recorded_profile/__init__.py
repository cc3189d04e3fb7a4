"""The profile of one chain, as a recording shows it: all that the planner needs of the chain.

* :mod:`.chain_profile`: the whole profile.
* :mod:`.stages`: the chain and the branches that it waits for, as steps of one graph.
* :mod:`.times`: how long callbacks and stages take.
* :mod:`.executors`: which executors run them, on which cores, and what else these run.
* :mod:`.output`: how the chain's output is published and received.
"""
