"""Run the command line as ``python -m fogft``."""

from fogft.cli.main import main

if __name__ == "__main__":
    main()
