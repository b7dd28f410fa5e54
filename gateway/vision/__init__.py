"""Images → markers: AprilTags, and balls of one colour.

Exports: `live`, a camera of this machine; `camera`, the interface (`Detector`, `Sighting`, `Intrinsics`);
`detectors.Detectors`, those that a robot file or a plant file asks for. Pixels end here: what enters a step
are measurements.
Must not import: buses, core, recording, sim. OpenCV is an extra and slow to import: `camera.opencv` alone.
"""
