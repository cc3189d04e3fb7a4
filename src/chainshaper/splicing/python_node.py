"""Put a node in Python into one file, behind the modules of `chainshaper.robot` it imports."""

import ast
from pathlib import Path

NODES = Path(__file__).parents[1] / "robot"
RESPAWNING = NODES / "python/respawning.py"
_SOURCES = Path(__file__).parents[2]


def python_node(executable: str) -> str:
    """Return the text of a node in Python as a single file."""
    parts: dict[Path, str] = {}

    def add(path: Path) -> None:
        """Add a file without its imports of chainshaper, behind the files that these name."""
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines(keepends=True)
        for statement in reversed(ast.parse(text).body):
            module = getattr(statement, "module", None) or ""
            if isinstance(statement, ast.ImportFrom) and module.startswith("chainshaper."):
                del lines[statement.lineno - 1 : statement.end_lineno]
                imported = _SOURCES / f"{module.replace('.', '/')}.py"
                if imported not in parts:
                    add(imported)
        parts[path] = "".join(lines)

    add(NODES / "python" / f"{executable}.py")
    return "#!/usr/bin/env python3\n" + "\n\n".join(parts.values())
