"""The experiments of the paper, on simulated captures of the same set-ups."""
