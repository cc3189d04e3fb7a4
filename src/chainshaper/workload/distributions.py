"""Durations that vary: execution times, and what a simulated machine takes for everything else."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from chainshaper.values.yaml_file import Duration, Part, PositiveDuration, wrong_value

__all__ = ["ExecutionTime", "SimulationDescription"]

LONGEST_BLOCK = 1024


class ExecutionTime(Part):
    """CPU time of one callback instance: exactly one of the distributions.

    ``constant``; ``uniform`` between two durations; ``normal`` with mean and standard deviation,
    redrawn outside ``within``; ``samples``, measured ones for example, drawn in stretches of
    ``block`` consecutive ones (1: independently). Callbacks with as many samples and the same
    block draw the same stretches, so that what was measured together stays together (the moving
    block bootstrap of Künsch, 1989, with the circular end of Politis and Romano, 1992).
    """

    constant_ns: Duration | None = None
    uniform_ns: tuple[Duration, Duration] | None = None
    normal_ns: tuple[Duration, Duration] | None = None
    within_ns: tuple[Duration, Duration] | None = None
    samples_ns: Annotated[tuple[Duration, ...], Field(min_length=1)] | None = None
    block: Annotated[int, Field(ge=1, le=LONGEST_BLOCK)] = 1

    @model_validator(mode="after")
    def _one_distribution(self) -> "ExecutionTime":
        given = [self.constant_ns, self.uniform_ns, self.normal_ns, self.samples_ns]
        if sum(value is not None for value in given) != 1:
            raise wrong_value("give exactly one of constant, uniform, normal, samples")
        if self.block > 1 and self.samples_ns is None:
            raise wrong_value("a block is a stretch of `samples`: remove it", "block")
        if (self.normal_ns is None) != (self.within_ns is None):
            raise wrong_value("`within: [low, high]` goes with `normal`, and normal needs it")
        for key, pair in (("uniform", self.uniform_ns), ("within", self.within_ns)):
            if pair is not None and pair[0] > pair[1]:
                raise wrong_value("the shorter duration comes first: exchange the two", key)
        if self.normal_ns is not None and self.within_ns is not None:
            mean, deviation = self.normal_ns
            if deviation == 0 or not self.within_ns[0] <= mean <= self.within_ns[1]:
                raise wrong_value(
                    "the mean must lie within the limits, with a deviation above 0ms", "normal"
                )
            if self.within_ns[1] - self.within_ns[0] < deviation:
                # Nearly every value would be drawn again, for ever if the limits are equal.
                raise wrong_value(
                    "the limits are closer together than one deviation: write `uniform`", "within"
                )
        return self


def _constant(nanoseconds: int) -> ExecutionTime:
    return ExecutionTime(constant_ns=nanoseconds)


class SimulationDescription(Part):
    """What a simulation has to be told and a machine knows by itself.

    CPU time: ``wake_up`` of a thread until it is at work, ``take`` of a message until its callback
    begins, ``publish`` of a message, by its executor or its publisher thread, ``receive`` of a
    message by a DDS thread (None: these do not compete with anybody). ``delivery`` is how long a
    message is under way, ``context_switch`` what switching to another thread costs the one
    switched to, ``preemption`` what being resumed costs besides, ``quantum`` how long threads of
    one server take turns for, ``interrupts`` the share of a core's time that interrupts and the
    stall meter take away from callbacks (it counts as their CPU time), ``drift`` how much faster
    the clocks of nodes are (ppm of a period).

    The costs that stand here are medians of several runs of the live workload on a virtual machine
    of two cores. Other machines, and other hours, have others.
    """

    executor: Literal["single-threaded", "static", "events"] = "single-threaded"
    wake_up: ExecutionTime = _constant(110_000)
    take: ExecutionTime = _constant(42_000)
    publish: ExecutionTime = _constant(95_000)
    delivery: ExecutionTime = _constant(30_000)
    receive: ExecutionTime | None = None
    context_switch_ns: Duration = 0
    preemption_ns: Duration = 0
    quantum_ns: PositiveDuration = 1_000_000
    interrupts: Annotated[float, Field(ge=0, lt=1)] = 0.016
    drift: dict[str, Annotated[float, Field(gt=-100_000, lt=100_000)]] = Field(default_factory=dict)
