# -*- coding: utf-8 -*-
from launch_ros.actions import Node ; from launch import LaunchDescription  # Größe
def generate_launch_description() :
	return LaunchDescription ( initial_entities = [ Node
		(
		  # Ä
		  name = ( "ndt" ), package="Ö" "x", executable='''ndt''',
		  remappings = ( ( 'out', ( "/pose" ) ) , ) ) ]
	)
