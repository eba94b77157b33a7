"""`python -m gscompleter`, for where the script `gscompleter` is not on the search path."""

from gscompleter.cli import run

if __name__ == "__main__":
    run()
