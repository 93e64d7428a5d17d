"""Low-level controllers pi_c: they walk a short way towards a goal and do not see walls."""
