# SPDX-License-Identifier: Apache-2.0
"""Package set-up, for colcon and pip alike."""

from setuptools import find_packages, setup

PACKAGE = "aeropend_control"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={"aeropend_control": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["numba", "numpy", "rich", "scipy"],
    extras_require={"test": ["pytest", "pytest-timeout"]},
    python_requires=">=3.10",
    zip_safe=False,
    maintainer="aeropend maintainers",
    maintainer_email="maintainers@aeropend.example",
    description="Excitation signals and controllers for the aeropendulum, one node each.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "excite = aeropend_control.nodes.excite:main",
            "small_signal = aeropend_control.nodes.controller:small_signal",
            "feedback_linearization = aeropend_control.nodes.controller:feedback_linearization",
            "cascade = aeropend_control.nodes.controller:cascade",
            "feedback_linearization_cascade = aeropend_control.nodes.controller:feedback_linearization_cascade",
            "reference = aeropend_control.nodes.reference:main",
            "step_test = aeropend_control.nodes.step_run:main",
            "tune = aeropend_control.commands.tune:main",
        ]
    },
)
