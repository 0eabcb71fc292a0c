from envs.driving.circuits import CIRCUITS
def load_track(t): return CIRCUITS[t]() if isinstance(t,str) else t
