"""
Pictures of the published models, a GIF per environment in docs/images.

    python -m benchmarks.probes.gifs
    python -m benchmarks.probes.gifs --envs Goal-v0

A few deterministic episodes each, with the frames inside a step; every picture is as large as the environment draws it.
"""

from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.probes.rollout import BENCHMARKS, load_model, make_env, parser_of, play, published
from sb3_chdp.envs import ENV_IDS

IMAGES = BENCHMARKS.parent / "docs" / "images"
EPISODES, MAX_PICTURES, COLOURS, MILLISECONDS = 5, 160, 32, 80
# Of environments with many frames: one picture in so many, and the last of an episode
STRIDES = {"Platform-v0": 9, "Goal-v0": 4, "HardGoal-v0": 4}


def record(model: Any, env_id: str, path: Path, episodes: int = EPISODES) -> None:
    """Write the GIF."""
    env = make_env(env_id, render_mode="rgb_array")
    unwrapped: Any = env.unwrapped
    chosen: list[Any] = []
    pictures: list[Any] = []
    for seed in range(episodes):
        pictures.clear()
        play(model, env, seed=seed, look=lambda: pictures.extend(unwrapped.render_frames()))
        episode = [*pictures[:: STRIDES.get(env_id, 1)], *[pictures[-1]] * 6]
        if chosen and len(chosen) + len(episode) > MAX_PICTURES:
            break
        chosen += episode
    env.close()
    # One palette for all pictures, or colours flicker
    images = [Image.fromarray(picture) for picture in chosen]
    palette = Image.fromarray(chosen[-1]).quantize(COLOURS)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, optimize=True)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--envs", nargs="+", choices=ENV_IDS, metavar="ENV", help="those with a published model if not given")
    args = parser.parse_args()
    for env_id in args.envs or [env_id for env_id in ENV_IDS if published(env_id).exists()]:
        path = IMAGES / f"{env_id}.gif"
        record(load_model(env_id), env_id, path)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
