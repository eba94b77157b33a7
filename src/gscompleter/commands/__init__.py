"""The commands, a file each, and what they can be told.

Each raises an InputError for whatever the user can mend, which the command line prints.
"""
