"""Scenarios for other simulators: a seed's traffic as OpenSCENARIO, its roads as OpenDRIVE."""
