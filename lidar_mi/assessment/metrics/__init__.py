"""Numbers from estimate and truth, one function each."""
