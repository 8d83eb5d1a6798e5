"""Training that is killed at any moment and goes on as if it had not been."""

import inspect
import io
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from weakref import WeakKeyDictionary

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_chdp.common.arguments import check, whole
from sb3_chdp.common.checkpoint_store import CheckpointStore, GenerationWriter
from sb3_chdp.common.env_state import class_names, has_state, restore_env, save_env, warn_of_losses
from sb3_chdp.common.plain_data import from_bytes, restore_state, to_bytes
from sb3_chdp.common.replay_store import ReplayStore, buffer_state, read_rows
from sb3_chdp.common.run_state import (
    model_state,
    restore_callbacks,
    restore_generators,
    restore_logger,
    restore_model,
    save_callbacks,
    save_generators,
    save_logger,
)
from sb3_chdp.common.serialization import import_own, qualified_name


class _Run(NamedTuple):
    """What is known of a model that has checkpoints."""

    stores: dict[Path, CheckpointStore]
    # What is put back when learn() begins, until then
    pending: dict[str, Any]


_RUNS: "WeakKeyDictionary[BaseAlgorithm, _Run]" = WeakKeyDictionary()


class ResumableCheckpoint(BaseCallback):
    """
    Callback for saving all that :func:`resume` needs to continue a training bit for bit.

    Checkpoints are taken between rollouts, when the last transition is stored and the last gradient step is done: at the
    first start of a rollout after every ``save_freq`` calls of ``env.step()``, and at the end of the training. The last two
    are kept. They hold the model, the replay buffer, all random generators, environments and their statistics, the logger,
    Monitor files and the counters of all callbacks.

    If the disk does not take a checkpoint, a warning says so and training goes on.

    To be handed to ``learn`` itself, alone or in a list.

    :param save_freq: Save a checkpoint every ``save_freq`` calls of the callback, each of which is ``n_envs`` steps
    :param save_path: Path to the folder of the checkpoints, which belongs to one run
    :param verbose: Verbosity level: 0 for no output, 2 for indicating when saving a checkpoint
    :raises ValueError: for a ``save_freq`` below 1; when learning starts, for a folder that another process writes to or
        that holds checkpoints of another run, for a callback within another one, and for a replay buffer that holds other
        things than numbers
    :raises OSError: when learning starts, if the folder cannot be written to
    """

    #: size of the files that hold the replay buffer; those without new transitions are not written again
    chunk_bytes: ClassVar[int] = 4 * 2**20

    def __init__(self, save_freq: int, save_path: str | Path, verbose: int = 0):
        super().__init__(verbose)
        check(whole(1), save_freq=save_freq)
        self.save_freq = save_freq
        self.save_path = Path(save_path)
        self._saved_at = 0  # number of calls
        self._n_rollouts = 0
        self._in_rollout = False
        self._replay = ReplayStore(self.chunk_bytes)

    def _init_callback(self) -> None:
        if self.parent is not None:
            raise ValueError(f"ResumableCheckpoint must be given to learn(), not to {type(self.parent).__name__}")
        run = _RUNS.setdefault(self.model, _Run({}, {}))
        path = self.save_path.resolve()
        self._store = run.stores.setdefault(path, CheckpointStore(self.save_path))
        if self._store.generations() and not self._store.whole:
            del run.stores[path]
            raise ValueError(
                f"save_path {self.save_path} holds the checkpoint {self._store.generations()[0].name} of another run: "
                f"continue that one with resume({str(self.save_path)!r}, env), or choose another folder"
            )
        self.save_path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=self.save_path):
            pass
        self._store.lock()
        buffer = _replay_buffer(self.model)
        if buffer is not None:
            buffer_state(buffer)
        save_env(self.training_env)
        if not run.pending:
            warn_of_losses(self.training_env)

    def _on_training_start(self) -> None:
        self._n_rollouts = 0
        self._replay.forget()
        pending = _RUNS[self.model].pending
        if pending and self.model.num_timesteps < pending["num_timesteps"]:
            raise ValueError("A resumed model goes on with learn(..., reset_num_timesteps=False), got True")
        total = pending.get("_total_timesteps", 0)
        if pending and total != self.model._total_timesteps and pending["num_timesteps"] < total:
            warnings.warn(
                f"The run was to end after {total} steps, now it ends after {self.model._total_timesteps}, and schedules with "
                f"it: learn(total_timesteps={total} - model.num_timesteps, ...) keeps the end"
            )

    def _on_rollout_start(self) -> None:
        resumed = self._restore()
        if not resumed and self._is_due() and self._is_between_logs():
            self._save()
        self._in_rollout = True

    def _is_due(self) -> bool:
        return self.n_calls // self.save_freq > self._saved_at // self.save_freq

    def _restore(self) -> bool:
        """
        Here, where it was saved, and not in ``resume()``: what others did since then does not count.

        :return: whether this is where a checkpoint was taken
        """
        pending = dict(_RUNS[self.model].pending)
        _RUNS[self.model].pending.clear()
        if not pending or pending["num_timesteps"] != self.model.num_timesteps:
            return False
        restore_callbacks(self._root, pending["callbacks"])
        restore_logger(self.model, pending["logger"])
        restore_generators(self.model, pending["generators"])
        self.model.start_time = time.time_ns() - pending["elapsed"]
        self.model._num_timesteps_at_start = pending["_num_timesteps_at_start"]
        return True

    def _is_between_logs(self) -> bool:
        # On-policy algorithms count rollouts within learn() to tell when to log
        log_interval = self.locals.get("log_interval")
        return not isinstance(self.model, OnPolicyAlgorithm) or not log_interval or self._n_rollouts % log_interval == 0

    @property
    def _root(self) -> BaseCallback:
        """:return: the callback of ``learn``, a list or this one"""
        return self.locals.get("callback", self)

    def _on_step(self) -> bool:
        self._replay.n_added += 1
        return True

    def _on_rollout_end(self) -> None:
        self._n_rollouts += 1
        self._in_rollout = False

    def _on_training_end(self) -> None:
        if self._restore():
            return  # there was nothing left to do
        # A callback that stops the training does so before the last transition is stored
        is_complete = not self._in_rollout and self.model.num_timesteps >= self.model._total_timesteps
        if is_complete and self._n_rollouts > 0:
            self._save()
            self._n_rollouts = 0

    def _save(self) -> None:
        self._saved_at = self.n_calls
        files: dict[str, dict[str, Any]] = {}

        def fill(writer: GenerationWriter) -> None:
            self._fill(writer)
            files.update(writer.files)

        try:
            folder = self._store.write(self.model.num_timesteps, fill)
        except OSError as error:
            last = self._store.whole[-1].name if self._store.whole else "none"
            warnings.warn(
                f"The checkpoint at {self.model.num_timesteps} steps could not be written to {self.save_path}: {error}. "
                f"Training goes on, the last checkpoint is {last}"
            )
            return
        buffer = _replay_buffer(self.model)
        if buffer is not None:
            self._replay.commit(buffer, folder, files)
        if self.verbose >= 2:
            print(f"Saving resumable checkpoint to {folder}")

    def _fill(self, writer: GenerationWriter) -> None:
        model = self.model
        zip_file = io.BytesIO()
        model.save(zip_file)
        writer.write("model.zip", zip_file.getbuffer())
        state = {
            "class": qualified_name(type(model)),
            "n_envs": model.n_envs,
            "use_masking": bool(getattr(model, "use_masking", False)),
            "vec_wrappers": class_names(self.training_env),
            "model": model_state(model),
            "env": save_env(self.training_env),
            "later": {
                "num_timesteps": model.num_timesteps,
                "_total_timesteps": model._total_timesteps,
                "_num_timesteps_at_start": model._num_timesteps_at_start,
                "elapsed": time.time_ns() - model.start_time,
                "generators": save_generators(model),
                "callbacks": save_callbacks(self._root),
                "logger": save_logger(model),
            },
        }
        buffer = _replay_buffer(model)
        if buffer is not None:
            state["buffer"] = buffer_state(buffer)
            state["buffer_size"] = buffer.buffer_size
            state["rows_per_chunk"] = self._replay.write(buffer, writer)
        text, arrays = to_bytes(state)
        writer.write("state.json", text)
        writer.write("state.npz", arrays)


def _algorithm(name: str) -> type[BaseAlgorithm]:
    """:return: the algorithm of that name, of this package or imported already: a checkpoint cannot have others run"""
    import_own(name)
    classes: list[type] = [BaseAlgorithm]
    for cls in classes:
        classes.extend(cls.__subclasses__())
        if qualified_name(cls) == name:
            return cls
    raise ValueError(f"The checkpoint is one of {name}: import that class first")


def resume(
    directory: str | Path, env: GymEnv, device: th.device | str = "auto", trusted: bool = False, **kwargs: Any
) -> BaseAlgorithm:
    """
    The model of the newest checkpoint that is whole, ready to go on with ``learn``:

        model = resume("run", env)
        model.learn(total_timesteps - model.num_timesteps, callback, reset_num_timesteps=False)

    What follows equals, to the last bit, what would have followed if the training had not been killed, given the same
    ``total_timesteps``, callbacks (:class:`ResumableCheckpoint` among them), logger and software, and an environment made the
    same way, with ``get_state()`` and ``set_state()``. Without these two a fresh episode begins.

    :param directory: ``save_path`` of the :class:`ResumableCheckpoint`
    :param env: the environment, made like that of the killed training
    :param device: Device on which the code should be run
    :param trusted: whether pickled objects may be read, see :meth:`HybridAlgorithm.load`; SB3's own algorithms always do
    :param kwargs: further arguments of the algorithm's ``load``
    :return: the model, with its replay buffer, environment and random generators where they were
    :raises FileNotFoundError: if there is no checkpoint
    :raises ValueError: if all checkpoints are damaged, or for another number of environments, other wrappers or another
        ``buffer_size``
    """
    store = CheckpointStore(directory)
    folder = store.newest()
    state = from_bytes((folder / "state.json").read_bytes(), (folder / "state.npz").read_bytes())
    algorithm = _algorithm(state["class"])
    vec_env = algorithm._wrap_env(env)
    if vec_env.num_envs != state["n_envs"]:
        raise ValueError(f"env must have {state['n_envs']} environment(s) like the checkpoint, got {vec_env.num_envs}")
    if class_names(vec_env) != state["vec_wrappers"]:
        raise ValueError(f"env must be wrapped in {state['vec_wrappers']} like the checkpoint, got {class_names(vec_env)}")
    if "trusted" in inspect.signature(algorithm.load).parameters:
        kwargs["trusted"] = trusted
        kwargs.setdefault("use_masking", state.get("use_masking"))
    model = algorithm.load(folder / "model.zip", env=vec_env, device=device, force_reset=False, **kwargs)
    restore_model(model, state["model"])
    buffer = _replay_buffer(model)
    if "buffer" in state and buffer is not None:
        if buffer.buffer_size != state.get("buffer_size", buffer.buffer_size):
            size, given = (n * vec_env.num_envs for n in (state["buffer_size"], buffer.buffer_size))
            raise ValueError(f"buffer_size must be {size} like the checkpoint, got {given}")
        restore_state(buffer, state["buffer"])
        read_rows(buffer, folder, state["rows_per_chunk"])
    vec_env.reset()
    restore_env(vec_env, state["env"])
    if state["env"]["states"] is None or not has_state(vec_env):
        warnings.warn("The environment has no get_state() and set_state(): a fresh episode begins", stacklevel=2)
        # learn() will reset the environment
        model._last_obs = None
    restore_generators(model, state["later"]["generators"])
    _RUNS[model] = _Run({Path(directory).resolve(): store}, state["later"])
    return model


def last_checkpoint(model: BaseAlgorithm) -> Path | None:
    """:return: folder of the last checkpoint that was written for the model, or that it was resumed from; None without one"""
    run = _RUNS.get(model)
    whole = [] if run is None else [folder for store in run.stores.values() for folder in store.whole]
    return max(whole, key=lambda folder: folder.stat().st_mtime, default=None)


def _replay_buffer(model: BaseAlgorithm) -> ReplayBuffer | None:
    return getattr(model, "replay_buffer", None)
