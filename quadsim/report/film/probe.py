"""`python -m quadsim.report.film.probe`: fails unless the OpenGL back end renders; imports nothing else."""

from __future__ import annotations

import mujoco


def probe() -> None:
    """Render one tiny picture, and fail unless there is something in it."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data)
        if not renderer.render().any():
            raise RuntimeError("the picture is black")


if __name__ == "__main__":
    probe()
