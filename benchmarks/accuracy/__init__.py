"""How near to the truth: scenarios with bars, recordings, consistency."""
