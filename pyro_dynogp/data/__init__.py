"""Measured records: reading, checking, scaling, channels made from them."""
