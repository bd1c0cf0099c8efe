"""The arm pushes a block that it sees in pictures, for LeRobot's EnvHub: the file that a repository on the hub has.

Whoever loads it needs `pip install 'urlab-client[gym]'`; each environment starts a simulated server of its own.
"""

from urlab_client.integrations.gym.envhub import vector_env


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return the environments as LeRobot asks for them: by the name of the suite and the number of the task."""
    envs = vector_env(
        "urlab/PushPictures-v0",
        n_envs,
        asynchronous=use_async_envs,
        description="push the block to the mark",
        observations=["qpos"],
    )
    return {"urlab_push": {0: envs}}
