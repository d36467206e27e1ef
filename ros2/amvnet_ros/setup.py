"""Install the node as a package of ROS 2."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

NAME = "amvnet_ros"
VERSION = ElementTree.parse(Path(__file__).with_name("package.xml")).findtext("version")

setup(
    name=NAME,
    version=VERSION,
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", ["config/segment.yaml"]),
        (f"share/{NAME}/launch", ["launch/segment.launch.py"]),
    ],
    install_requires=["setuptools", "amvnet"],
    zip_safe=True,
    maintainer="The AMVNet authors",
    maintainer_email="amvnet@example.com",
    description="A node that gives every point of a LiDAR scan its class, by AMVNet",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"segment = {NAME}.node:main"]},
)
