"""The paper's experiments, with this library and its peers on the same records in one run."""
