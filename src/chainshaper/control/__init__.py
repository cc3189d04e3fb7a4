"""What latency and jitter cost a controller: a plant, its noise, its cost and a controller.

A plant is sampled when a chain starts, and its input changes when the chain's output arrives. The
covariance of the whole loop is carried exactly from event to event (:mod:`.costs`), or solved for
the steady state (:mod:`.steady_state`). A loop is read from a file (:mod:`.plant_file`) or made of
python-control's objects (:func:`~.loop.plant_of`).
"""
