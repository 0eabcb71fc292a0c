"""The physics engines."""

import mujoco

# A simulation that fails, as from an action that is not a number, still warns on the console, but
# leaves no MUJOCO_LOG.TXT in the working folder.
_log = mujoco.MjLogConfig.get()
_log.logto_file = False
mujoco.MjLogConfig.set(_log)
