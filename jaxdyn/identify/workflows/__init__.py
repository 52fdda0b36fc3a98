"""Workflows around identification: logs, excitation, drive gains, payloads."""
