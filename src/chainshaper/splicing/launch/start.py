"""How a launch file starts a shaping node: its command line, in no launch file's notation yet."""

from chainshaper.splicing.shaping_process import ShapingProcess

__all__ = ["command_line"]


def command_line(command: tuple[str, ...], process: ShapingProcess) -> list[str]:
    """A command with the process's name, parameters and remaps as ROS arguments behind it."""
    rules = [
        ("__node", process.name),
        ("__ns", process.namespace),
        *process.remappings,
    ]
    parameters = ["--params-file", str(process.parameters_file)]
    remaps = [word for match, target in rules for word in ("-r", f"{match}:={target}")]
    return [*command, "--ros-args", *remaps, *parameters]
