"""Commands, one per file: the options, and a function that runs them.

Help pages read these files, so none of them imports torch: each function imports its work, which
lies in the other packages, when it is called.
"""
