"""A camera in the world: images of the scene, drawn by MuJoCo without a display, and the detectors behind it.

Rules. Drawing needs OpenGL by way of EGL, which software provides, too (Debian: libegl1, libegl-mesa0). The
same image comes out for the same scene on one version of the drawing library and one processor. Noise is that
of each pixel, from a random stream of the camera's own. What was found in an image comes out one after the
other, in the steps after it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from brain.perception.mount import Mount
from gateway.sim.load import WorldError
from gateway.sim.plant_files import Camera
from gateway.vision.camera import Image, Seen, events
from protocols.messages import SECOND, Marker, Nanos

if TYPE_CHECKING:
    from gateway.sim.scene import SimulatedScene

NEAR, FAR = 0.02, 60.0
"""m: nothing is drawn nearer or farther."""


class Renderer:
    """Draws a scene as cameras see it. Not plain data: it holds a context of OpenGL."""

    def __init__(self, scene: SimulatedScene, camera: Camera) -> None:
        """Raises WorldError if there is no OpenGL."""
        import mujoco  # the scene has it

        scene.model.vis.global_.offwidth, scene.model.vis.global_.offheight = camera.width, camera.height
        try:
            from mujoco.egl import GLContext

            self._gl: Any = GLContext(camera.width, camera.height)
            self._gl.make_current()
            self._context: Any = mujoco.MjrContext(scene.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # whatever OpenGL's loader raises
            hint = f"a camera needs OpenGL by EGL ({error}): apt-get install libegl1 libegl-mesa0"
            raise WorldError.about(f"world {scene.file.name!r}", [hint]) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._mujoco, self._camera = mujoco, camera
        self._scene: Any = mujoco.MjvScene(scene.model, maxgeom=5000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._free: Any = mujoco.MjvCamera()
        self._options: Any = mujoco.MjvOption()

    def draw(self, scene: SimulatedScene, mount: Mount) -> Image:
        """Return the image of a camera on a mount of the robot, at the beginning of the last step."""
        lib, camera, view = self._mujoco, self._camera, self._scene
        self._gl.make_current()
        lib.mjv_updateScene(
            scene.model, scene.data, self._options, None, self._free, lib.mjtCatBit.mjCAT_ALL, view
        )
        origin, axes = scene.frame(mount)
        top = NEAR * math.tan(math.radians(camera.view) / 2.0) * camera.height / camera.width
        for eye in view.camera:
            eye.pos, eye.forward, eye.up = origin, axes[:, 0], axes[:, 2]
            eye.orthographic = 0
            eye.frustum_center, eye.frustum_width = 0.0, 0.0
            eye.frustum_bottom, eye.frustum_top = -top, top
            eye.frustum_near, eye.frustum_far = NEAR, FAR
        image: Image = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
        whole = lib.MjrRect(0, 0, camera.width, camera.height)
        lib.mjr_render(whole, view, self._context)
        lib.mjr_readPixels(image, None, whole, self._context)
        return image[::-1]


class CameraSensor:
    """A camera on a mount."""

    def __init__(self, name: str, file: Camera, mount: Mount, rng: np.random.Generator) -> None:
        self.name, self.file, self.mount = name, file, mount
        self.period: Nanos = round(SECOND / file.rate_hz)
        self._rng = rng
        self._renderer: Renderer | None = None
        self._found: deque[Marker] = deque()
        self.seen: Seen | None = None
        """The newest image."""

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> Marker | None:
        """Look at the beginning of a period; return one of what was found and not yet returned."""
        if phase == 0:
            image, intrinsics = self.image(scene), self.file.intrinsics
            self.seen = Seen(t, image, intrinsics)
            sightings = self.file.detectors.detect(image, intrinsics)
            self._found.extend(events(self.name, t, sightings))
        return self._found.popleft() if self._found else None

    def image(self, scene: SimulatedScene) -> Image:
        """Return what it sees now, with noise."""
        if self._renderer is None:
            self._renderer = Renderer(scene, self.file)
        clean = self._renderer.draw(scene, self.mount)
        if not self.file.noise:
            return np.ascontiguousarray(clean)
        noisy = clean + self.file.noise * self._rng.standard_normal(clean.shape, dtype=np.float32)
        return np.clip(np.round(noisy), 0.0, 255.0).astype(np.uint8)
