# SPDX-License-Identifier: Apache-2.0
"""Package set-up, for colcon and pip alike."""

from setuptools import find_packages, setup

PACKAGE = "aeropend_sim"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={"aeropend_sim": ["config/*", "urdf/*.urdf", "layouts/*", "export/*.c", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["aeropend_sim/config/bench.yaml", "aeropend_sim/config/thesis.yaml"]),
        (f"share/{PACKAGE}/urdf", ["aeropend_sim/urdf/aeropendulum.urdf"]),
        (f"share/{PACKAGE}/layouts", ["aeropend_sim/layouts/foxglove.json", "aeropend_sim/layouts/plotjuggler.xml"]),
    ],
    install_requires=["argcomplete", "numba", "numpy", "PyYAML", "rich", "scipy"],
    extras_require={"mujoco": ["mujoco"], "test": ["FMPy", "hypothesis", "mujoco", "pytest", "pytest-timeout"]},
    python_requires=">=3.10",
    zip_safe=False,
    maintainer="aeropend maintainers",
    maintainer_email="maintainers@aeropend.example",
    description="The aeropendulum's model (dynamics, actuator, sensing, effects) and the simulated plant node.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "aeropend = aeropend_sim.cli.aeropend:main",
            "export = aeropend_sim.export.command:main",
            "import_model = aeropend_sim.export.import_model:main",
            "plant = aeropend_sim.nodes.plant:main",
            "pose = aeropend_sim.nodes.pose:main",
        ]
    },
)
