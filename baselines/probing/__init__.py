"""Probers: what is added to a flight to find its fault sooner. One file each, `prober(plant, **settings) -> Prober`."""
