"""Files, locks and child processes: what knows nothing of scenes and devices."""
