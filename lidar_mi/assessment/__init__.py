"""The verdict: errors against the truth, figures and the report of a run."""
