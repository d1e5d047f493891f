"""Climbing to posterior modes."""
