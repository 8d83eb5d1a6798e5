"""Videos that show the frames inside a step."""

import os

from stable_baselines3.common.vec_env import VecVideoRecorder
from stable_baselines3.common.vec_env.base_vec_env import tile_images


class FrameVideoRecorder(VecVideoRecorder):
    """
    SB3's ``VecVideoRecorder``, which takes every frame of environments that simulate several per step.

    Such environments have a method ``render_frames``, see :class:`sb3_chdp.envs.base.HybridEnv`; of others it takes a picture
    per step as SB3 does. ``video_length`` counts pictures: a video ends with the step that reaches it.
    """

    def _start_recording(self) -> None:
        self._has_frames = self.venv.has_attr("render_frames")
        self._first_step = self.step_id
        super()._start_recording()

    def _capture_frame(self) -> None:
        if not self._has_frames:
            super()._capture_frame()
            return
        frames = self.venv.env_method("render_frames")
        for i in range(max(map(len, frames))):
            # An environment whose step had fewer frames stands still
            self.recorded_frames.append(tile_images([own[min(i, len(own) - 1)] for own in frames]))
        self.video_name = f"{self.name_prefix}-step-{self._first_step}-to-step-{self.step_id}.mp4"
        self.video_path = os.path.join(self.video_folder, self.video_name)
