"""What every part of the package leans on: errors, tensors, compiled code, processes."""
