"""Localisation in automated valet parking with real computation (paper, section 5.1, figure 4)."""
