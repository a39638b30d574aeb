"""Builds the package with colcon."""

from glob import glob

from setuptools import setup

NAME = "hybridvo_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/rviz", glob("rviz/*.rviz")),
    ],
    install_requires=["setuptools", "hybridvo"],
    zip_safe=True,
    maintainer="hybridvo",
    maintainer_email="hybridvo@users.noreply.github.com",
    description="Visual odometry from RGB-D images, with covariance and status",
    license="BSD-3-Clause",
    entry_points={
        "console_scripts": [
            f"odometry = {NAME}.odometry:main",
            f"compare = {NAME}.compare:main",
        ]
    },
)
