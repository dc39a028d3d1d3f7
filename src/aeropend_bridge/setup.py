# SPDX-License-Identifier: Apache-2.0
"""Package set-up, for colcon and pip alike."""

from setuptools import find_packages, setup

PACKAGE = "aeropend_bridge"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={"aeropend_bridge": ["config/*.yaml", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["aeropend_bridge/config/motor_shield.yaml"]),
    ],
    install_requires=["cobs", "pyserial", "PyYAML"],
    extras_require={"test": ["hypothesis", "pytest", "pytest-timeout"]},
    python_requires=">=3.10",
    zip_safe=False,
    maintainer="aeropend maintainers",
    maintainer_email="maintainers@aeropend.example",
    description="The bridge to the real aeropendulum's board.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": ["bridge = aeropend_bridge.bridge:main", "calibrate = aeropend_bridge.calibrate:main"]
    },
)
