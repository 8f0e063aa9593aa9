"""How the cost of events grows, measured and predicted; run it with `python tools/cost_growth`."""
