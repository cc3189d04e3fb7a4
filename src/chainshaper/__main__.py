"""``python -m chainshaper`` is the same as ``chainshaper``."""

from chainshaper.cli import main

if __name__ == "__main__":
    main()
