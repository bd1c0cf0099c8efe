"""The `env.py` of a repository on LeRobot's EnvHub: the arm pushes a block that it sees in pictures.

Loading it needs `pip install 'urlab-client[gym]'`. Each environment starts its own simulated server.
"""

from urlab_client.integrations.gym.envhub import vector_env


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return the environments in LeRobot's format: by suite name and task number."""
    envs = vector_env(
        "urlab/PushPictures-v0",
        n_envs,
        asynchronous=use_async_envs,
        description="push the block to the mark",
        observations=["qpos"],
    )
    return {"urlab_push": {0: envs}}
