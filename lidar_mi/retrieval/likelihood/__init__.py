"""One fit of a likelihood with priors: scoring, damped scoring, variance components."""
