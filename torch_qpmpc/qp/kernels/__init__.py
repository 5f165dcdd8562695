"""Loops compiled for the CPU, per QP and per theta, and torch forms for other devices."""
