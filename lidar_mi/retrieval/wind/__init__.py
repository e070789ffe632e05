"""What users call: winds of pairs, series, slabs and volumes."""
