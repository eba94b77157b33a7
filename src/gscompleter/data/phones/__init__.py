"""Exports of apps that record photographs, poses and depth on a phone."""
