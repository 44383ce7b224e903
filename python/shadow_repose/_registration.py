"""The name of the environment in Gymnasium."""
from __future__ import annotations


def register() -> None:
    """Registers `ShadowRepose-v0` for `gymnasium.make` and `gymnasium.make_vec`.

    This happens by itself if Gymnasium is imported before this package, or if `shadow_repose.envs` is imported.
    """
    from gymnasium.envs import registration

    if "ShadowRepose-v0" not in registration.registry:
        registration.register("ShadowRepose-v0", entry_point="shadow_repose.envs:Env", vector_entry_point="shadow_repose.envs:VectorEnv")
