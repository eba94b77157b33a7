"""Parsing of the command line, its help pages, exit codes and sentences for failures."""
