"""Measuring where the time goes on a link."""
