"""Tests of residuals: filters, bootstrap, regressions, omnibus test."""
