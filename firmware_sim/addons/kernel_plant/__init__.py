"""Vehicle body without pybullet: the vectorized simulator's rigid-body kernel and own contacts.

`--plant kernel` selects it; it is the default where pybullet is not installed. Contacts follow
Bullet's algorithms and constants, so a vehicle on the floor moves the same.
Depends on: `firmware_sim.engine`, `firmware_sim.plant`; needs no other add-on. `airl faults` flies
on it. Guide: docs/explanation/physics.md.
"""

BODIES = {"kernel": "firmware_sim.addons.kernel_plant.kernel_body:KernelBody"}
