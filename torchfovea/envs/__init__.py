"""Environments to learn in where to look, after Gymnasium: `torchfovea/VisualSearch-v0`, single and as a batch.

Importing this package registers the environment. It needs the extra `rl`, and `sim` where scenes are simulated.
"""

try:
    import gymnasium
except ModuleNotFoundError as error:
    message = "gymnasium is not installed: expected the extra rl (pip install 'torchfovea[rl]')"
    raise ModuleNotFoundError(message, name="gymnasium") from error

__all__ = ["ENVIRONMENT"]

ENVIRONMENT = "torchfovea/VisualSearch-v0"

gymnasium.register(
    id=ENVIRONMENT,
    entry_point="torchfovea.envs.single:VisualSearchEnv",
    vector_entry_point="torchfovea.envs.vector:VisualSearchVectorEnv",
)
