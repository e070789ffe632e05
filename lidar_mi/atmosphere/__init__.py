"""The truth: wake flows, aerosol extinction, sub-grid texture and scattering matrices."""
