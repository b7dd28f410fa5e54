"""ddsm."""
