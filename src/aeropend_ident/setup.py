# SPDX-License-Identifier: Apache-2.0
"""Package set-up, for colcon and pip alike."""

from setuptools import find_packages, setup

PACKAGE = "aeropend_ident"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={"aeropend_ident": ["diagnosis/report/templates/*.j2", "launch/*.yaml", "live/page/*",
                                     "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch",
         [f"{PACKAGE}/launch/{name}.launch.yaml" for name in ("experiment", "hardware", "live", "sim")]),
    ],
    install_requires=["Jinja2", "joblib", "lz4", "numba", "numpy", "openpyxl", "pysindy", "PyYAML", "rich", "rosbags",
                      "scipy", "threadpoolctl", "tornado"],
    extras_require={"dask": ["dask", "distributed"], "matlab": ["h5py"],
                    "test": ["h5py", "mcap-ros2-support", "pytest", "pytest-timeout"]},
    python_requires=">=3.10",
    zip_safe=False,
    maintainer="aeropend maintainers",
    maintainer_email="maintainers@aeropend.example",
    description="Records and replays the aeropendulum, compares it with the model and names what the model is missing.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "import = aeropend_ident.commands.import_table:main",
            "record = aeropend_ident.nodes.record:main",
            "replay = aeropend_ident.nodes.replay:main",
            "recover = aeropend_ident.commands.recover:main",
            "diagnose = aeropend_ident.commands.diagnose:main",
            "identify = aeropend_ident.commands.identify:main",
            "bench_test = aeropend_ident.commands.bench:main",
            "excitation_quality = aeropend_ident.commands.excitation_quality:main",
            "design = aeropend_ident.commands.design:main",
            "investigate = aeropend_ident.commands.investigate:main",
            "isolate = aeropend_ident.commands.isolate:main",
            "step_response = aeropend_ident.commands.step_response:main",
            "doctor = aeropend_ident.commands.doctor:main",
            "watch = aeropend_ident.nodes.watch:main",
            "demo = aeropend_ident.commands.demo:main",
            "live = aeropend_ident.commands.live:main",
            "precompile = aeropend_ident.commands.precompile:main",
        ]
    },
)
