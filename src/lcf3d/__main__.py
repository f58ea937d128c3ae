"""``python -m lcf3d``, which torchrun needs."""

from lcf3d.cli.app import main

if __name__ == "__main__":
    main()
