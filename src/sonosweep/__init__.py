"""sonosweep: freehand ultrasound sweeps without a tracker, into trajectories and volumes."""
