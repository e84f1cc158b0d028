"""The cheapest model that is accurate enough, found from one-dimensional fields."""
