"""What looks like the change of a nominal parameter."""

from dataclasses import replace

import numpy as np

from jaxtune.discovery.fit import Fit, Free
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.screen import looks_like


def hypothesis(name, axis, least=-1.0):
    return Hypothesis(
        name=name,
        family="any",
        places=("joint",),
        directions=np.eye(5)[[axis]],
        probes=np.array([[0.5]]),
        bounds=np.array([[least, 1.0]]),
        prior=np.ones(1),
        joints=(0,),
    )


def test_a_change_looks_like_what_moves_the_residuals_as_it_does():
    change, other, third = np.eye(60)[:3]
    free = Free(directions=np.eye(5)[:1], sd=np.ones(1), bounds=np.array([[-5.0, 5.0]]), nominal=np.ones(1, bool))
    fit = Fit(free=free, coordinates=np.ones(1), residual=other, jacobian=change[:, None], weight=0.5)
    # A share of 0.81 of what the change does, and of 0.36.
    columns = {
        (1, 0.5): 3 * change,
        (2, 0.5): 0.9 * change + np.sqrt(0.19) * third,
        (3, 0.5): 0.6 * change + 0.8 * third,
    }
    columns[4, 0.5] = -change
    same, near, far, less = (
        hypothesis(name, axis) for axis, name in enumerate(("same", "near", "far", "less"), start=1)
    )

    def alike(hypotheses, share, axis=0, change=1.0):
        moved = replace(fit, coordinates=np.array([change]))
        return looks_like(moved, columns, axis, hypotheses, share)

    assert alike([near, far, same, less], 0.8) == ("same", "less", "near")
    assert alike([near, far, same], 0.3) == ("same", "near", "far")
    # What can only be added explains a change in one direction alone.
    added = hypothesis("less", 4, least=0.0)
    assert alike([added], 0.8) == ()
    assert alike([added], 0.8, change=-1.0) == ("less",)
    assert alike([same], 0.8, axis=2) == (), "nothing that is free lies along this axis"
