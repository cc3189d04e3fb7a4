"""What a run shows of itself: its state, with notes for a person."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from chainshaper.enforcement.undoing import (
    LoopState,
    LoopStep,
    RunState,
    ServerState,
    save_run_state,
)


@dataclass
class RunReport:
    """The state of a run, which changes as a whole."""

    folder: Path  # of the run
    state: RunState

    def note(self, *notes: str, instead: Collection[str] = ()) -> None:
        """Add notes, each once, in place of those that are in ``instead``."""
        others = (note for note in self.state.notes if note not in instead)
        self.state = replace(self.state, notes=tuple(dict.fromkeys((*others, *notes))))

    def replace_notes(self, prefix: str, *notes: str) -> None:
        """Add notes in place of all that begin with a prefix."""
        self.note(*notes, instead=[note for note in self.state.notes if note.startswith(prefix)])

    def show_steps(self, steps: Sequence[LoopStep]) -> None:
        """Show how loops were kept in step."""
        self.state = replace(self.state, steps=tuple(steps))

    def show_loops(self, loops: Iterable[LoopState]) -> None:
        """Show how loops that are kept in step are now."""
        self.state = replace(self.state, loops=tuple(loops))

    def update_servers(self, update: Callable[[ServerState], ServerState]) -> None:
        """Change what is shown of each server."""
        self.state = replace(self.state, servers=tuple(map(update, self.state.servers)))

    def save(self, state: RunState) -> str:
        """Write the state for `chainshaper status`; say why that failed, "" if it did not."""
        try:
            save_run_state(self.folder, state)
        except OSError as error:  # the plan is in force all the same
            reason = f"`status` cannot show how this run is doing ({error.strerror})"
            return f"{self.folder}: {reason}"
        return ""
