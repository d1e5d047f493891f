"""After `compile_kernels` nothing is left to compile, for no model and no verb."""

import subprocess
import sys

# In a process of its own: in this one other tests have called kernels already.
SCRIPT = """
import gc, warnings
import numpy as np
from numba.core.dispatcher import Dispatcher
import pyro_dynogp as dgp
from pyro_dynogp.prediction.compilation import PARTS, compile_kernels

compile_kernels(workers=1, progress=False)

def kinds():
    found = {}
    for kernel in gc.get_objects():
        if isinstance(kernel, Dispatcher) and kernel.py_func.__module__.startswith("pyro_dynogp"):
            name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
            found[name] = len(kernel.signatures)
    return found

before = kinds()
warnings.simplefilter("ignore")
rng = np.random.default_rng(0)
time, y = 0.1 * np.arange(40), rng.standard_normal((40, 2))
one = dgp.Record(time=time, inputs=rng.standard_normal(40), outputs=y[:, 0])
uneven = np.sort(rng.random(40))
y[3, 0] = np.nan
two = dgp.Record(time=uneven, inputs=rng.standard_normal(40), outputs=y)
how = {"workers": 1, "progress": False, "restarts": 1, "steps": 2}
for record, model in (
    (one, dgp.LinearDynamicGP(1, pairs=1)),
    (two, dgp.LinearDynamicGP(1, outputs=2, pairs=1)),
    (one, dgp.Wiener(1, pairs=1)),
    (one, dgp.WienerHammerstein(1, pairs=1)),
    (one, dgp.NonlinearFeedback(1, pairs=1)),
    (one, dgp.Cascade(1, (dgp.Dynamic(),), dgp.StudentT())),
):
    fit = dgp.fit(model, record, **how)
    fit.forecast(record[:30], record[30:])
    fit.simulate(record)
    fit.predict(record, horizon=2)
    fit.layers(record)
after = kinds()
more = {name: after[name] - count for name, count in before.items() if after[name] > count}
assert before and not more, more
"""


def test_every_kernel_is_compiled_ahead():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
