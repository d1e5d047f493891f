"""What a fitted model lacks: residuals, tests that name an effect, the effect added, the error."""
