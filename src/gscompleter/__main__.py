"""`python -m gscompleter`, where the script is not on the path."""

from gscompleter.cli import run

if __name__ == "__main__":
    run()
