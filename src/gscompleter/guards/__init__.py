"""Safeguards beyond the paper, one file each."""
